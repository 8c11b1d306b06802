"""What a person sees: the command line, the demo and its pictures."""
