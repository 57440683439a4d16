"""Tables of text and exports of motion capture: cells, units, times, mappings, logs of actuation."""
