"""Many labelled sequences: the jobs of `dase synth` and `dase demo`."""
