"""`mapctl bench tweener`: the tables of Zhou et al. 2020, one module each."""
