//! Power cuts of each party after each frame of the commissioner.
