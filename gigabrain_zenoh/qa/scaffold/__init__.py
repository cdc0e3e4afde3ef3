"""Writes the packages of new processes, perceptors and behaviours."""
