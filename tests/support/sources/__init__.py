"""Messages and files of other programs, as they write them."""
