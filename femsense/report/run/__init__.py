"""The chapter on a run: one file a section."""
