"""From a surface to a robot."""
