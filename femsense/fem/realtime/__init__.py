"""States at the rate of a camera."""
