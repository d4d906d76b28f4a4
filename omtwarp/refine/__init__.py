"""Refinement: the least distorted map near a given one, by minimisation with a barrier against flips."""
