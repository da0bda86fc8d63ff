"""Use of recorded runs without a simulator: replay, and learning from bags. Pure."""
