"""Benchmarks of generative tweening (Zhou et al. 2020, section 4)."""
