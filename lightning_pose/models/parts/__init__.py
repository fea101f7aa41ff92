"""What several architectures share: ridge regression, graph convolutions, neighbour graphs, motion of features."""
