"""The published method as a baseline: its contact detection, its matching, and one linear step per frame."""
