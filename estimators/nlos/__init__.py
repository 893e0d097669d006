"""Is an anchor blocked? Each method says how much its observation speaks for it; one sum decides.

What a method says is a log-likelihood ratio: the logarithm of how much likelier its observation is when
something stands between tag and anchor (no line of sight, NLOS) than when nothing does. Their sum with the
prior log-odds gives the probability that the range is blocked, and a range that is more likely blocked than
not is rejected. Its reason is the method that spoke for it most; when none did, it is that its anchor was
blocked a moment ago. So a weak first path, or a box of unknown height, does not reject a range that agrees
with the pose when its anchor was clear a moment ago, but it takes less to reject it then.

Source: Bayes' rule for independent observations and a two-state Markov chain, Thrun, Burgard and Fox,
Probabilistic Robotics, 4.2; the rest as `estimators.kernels.blocked` says.
"""
