"""What models in training are measured by."""
