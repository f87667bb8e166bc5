"""42, the spacecraft simulator: its text messages, and the TCP connection that they come on."""
