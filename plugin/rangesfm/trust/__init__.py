"""Trust: every plausible mistake of a survey as a hypothesis that is tested."""
