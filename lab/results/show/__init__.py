"""Pictures of single frames and videos with what a run found drawn over them."""
