"""Recordings as the loop sees them: trials, what is held out, outliers, rows of clouds."""
