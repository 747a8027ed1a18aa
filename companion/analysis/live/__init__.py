"""Live view: a process of its own that follows a log while it is written and shows it on one local page."""
