"""The figures and tables of the paper, and the speed of the parts."""
