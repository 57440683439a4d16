"""What a user starts: the command line and its commands."""
