"""The data of the loop: trials, held-out frames, outliers, rows of clouds."""
