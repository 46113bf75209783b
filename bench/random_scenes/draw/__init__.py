"""What a random scene is made of: rigs, cameras, vehicles, motions and nuisances, drawn at random."""
