"""What a run is told: its settings and its inputs."""
