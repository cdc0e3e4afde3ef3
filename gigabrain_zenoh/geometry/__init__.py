"""SE(2), swept footprints, limits of motion, ramps, scans and the poses they were taken at. Pure.

It imports no other room but errors.
Every room that computes with poses may import it.
"""
