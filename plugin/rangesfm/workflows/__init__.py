"""The method from end to end: a run, a model refined, surveys joined."""
