"""Refinement: robust weighted Levenberg-Marquardt.

``lm`` holds the refiner and its stages. ``residual`` holds the reprojection residual and its normal equations.
``terms`` holds priors of pose and camera. ``kernels`` holds robust kernels and bounded hyperparameters.
"""
