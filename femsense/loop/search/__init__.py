"""The search for effects: screening, refits, forward selection, acceptance, swaps."""
