"""An independent generator of touched soft robots: scikit-fem, neo-Hookean, its own rays; it shares no line with the program."""
