"""Inner loops of the particle filters and of factor graphs, compiled by numba.

Import these modules only where a filter is made: numba loads slowly. What is compiled is kept on disk, so
only the very first start takes the compiler's time. The tests hold every function against plain NumPy.

Particles are rows of 9 numbers, see `estimators.particle_cloud`. Ranges are rows of (anchor x, anchor y,
measured, sigma), horizontal [m]; landmarks are rows of (x, y, range [m], bearing [rad], sigma of the range,
sigma of the bearing). Both are in the map frame. A range has one residual, a landmark two.
"""
