"""Commands of `rlservo`, a file for each: options and printing; the work is in the other folders."""
