"""Sparse factors and solves."""
