"""Files of other programs that may hold more than data, read as data: nothing in them is executed."""
