"""The discretisation error of a robot."""
