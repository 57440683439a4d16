"""Contacts and forces, frame by frame."""
