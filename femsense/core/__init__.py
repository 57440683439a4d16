"""What every room uses: errors, arrays, poses, least squares, parallel work, words of messages."""
