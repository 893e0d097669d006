"""Factor graphs over poses, velocities, landmarks and anchors: built, solved, kept as a sliding window.

Every variable is three numbers (`factors.Graph`), so every graph is a matrix of blocks of three by three, and
one sparse Cholesky factorisation (`kernels.block_cholesky`) serves all: a chain of poses is block tridiagonal
in the order of time; landmarks, biases and loop closures only change the order of elimination.

Source: huang2024 Eq. (29)-(38).
"""
