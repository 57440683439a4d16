"""Used by every room: errors, arrays, poses, least squares, parallel work, texts of messages."""
