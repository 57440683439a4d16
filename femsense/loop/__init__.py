"""Closing the loop: from the residual of measured data to a named effect and a better model."""
