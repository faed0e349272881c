"""Commands of `rlservo`, one file each, with options and output; the work is in the other folders."""
