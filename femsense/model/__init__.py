"""The robot, its recording, its effects, and what cameras see of them."""
