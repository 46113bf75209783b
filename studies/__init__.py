"""The experiments of the five papers, repeated, their figures beside ours; the training of the learned detector."""
