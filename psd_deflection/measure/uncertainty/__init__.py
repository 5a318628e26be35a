"""How sure a block is: its noise from the stream, its dots at its stamp, its readings against each other."""
