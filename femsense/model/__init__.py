"""The robot, its recording, its effects, and their observation by cameras."""
