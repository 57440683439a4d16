"""The published method, as a baseline to compare with: its matching, its contact detection, one linear step."""
