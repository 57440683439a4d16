"""The demo: the whole chain on a recording that comes along."""
