"""What the networks of the realism measure go by: joints, bands of frequency, inputs, moments and gaits."""
