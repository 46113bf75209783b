"""What a run costs, stage by stage."""
