"""Dual posture stitching (Ren et al. 2024): two generators walk towards each other from two poses and are stitched."""
