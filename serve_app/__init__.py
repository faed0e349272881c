"""Running exported policies: in process (`policy`), as a server (`app`), and from a client (`client`)."""
