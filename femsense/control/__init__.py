"""The way back: from where points of the body are wanted to the inputs that bring them there."""
