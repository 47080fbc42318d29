"""What files of skinned characters (glTF, VRM, USD, FBX) have in common: rest frames, key times, names, choices."""
