"""The chapter on a closed loop: one file a section."""
