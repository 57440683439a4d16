"""Experiments: identifiability of effects, and proposals."""
