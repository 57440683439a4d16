"""Experiments: what they could show, and which to record next."""
