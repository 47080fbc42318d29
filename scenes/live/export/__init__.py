"""Recordings from the button's press to the file: begun, ended, written beside the show, and broken off."""
