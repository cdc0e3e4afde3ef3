"""SE(2), swept footprints, limits of motion, ramps, scans, their poses, and links of arms. Pure.

It imports no other room but errors.
Every room that computes with poses may import it.
"""
