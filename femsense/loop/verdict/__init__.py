"""What the search shows: the verdict, what is handed back, what cannot be distinguished."""
