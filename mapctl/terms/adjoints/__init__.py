"""Hand-written gradients of the terms that following and steering use, on the quantities of a trial."""
