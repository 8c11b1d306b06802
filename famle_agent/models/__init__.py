"""The dynamics model, what it sees of an observation, and the gradient steps that change it."""
