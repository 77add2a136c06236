"""Pictures localised in a run or a map: the places they are like, and the pose by what is known of these."""
