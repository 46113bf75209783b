"""The light tracker: a drogue's pattern followed by correlation between the frames of a detector."""
