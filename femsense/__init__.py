"""femsense: an ordinary depth camera as a force sensor for soft robots."""

__version__ = "0.1.0"
