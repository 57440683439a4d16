"""What closing the loop returns, and the plain tables of loop.json."""
