"""The demo: the whole chain on a recording of the package."""
