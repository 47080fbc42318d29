"""FBX files by the package ufbx."""
