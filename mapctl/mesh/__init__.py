"""A body for any skeleton: where its parts are, and the mannequin that films, files and the viewer show."""
