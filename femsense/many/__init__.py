"""Many recordings: jobs, the engines that run them on processes or machines, their records, and one summary of all."""
