"""What the tests share: bench files, commands, senders, servers, screens and serial lines."""
