"""Live streams: messages, recipients, and replies."""
