"""Rules that one pattern decides, by the kind of the clause."""
