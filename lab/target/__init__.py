"""What the trackers of one target share: frames of a recording, verdict, summary, overlay video, parts of a page."""
