"""Forces while they happen: cameras and actuation that are read live, the session, and what it records."""
