"""Refinement: robust weighted Levenberg-Marquardt.

``lm`` holds the module and its stages. ``residual`` holds the reprojection residual and its normal equations.
``information`` computes the precision of pixels from noise. ``terms`` holds priors of pose and camera. ``kernels``
holds robust kernels. ``parameters`` holds learned hyperparameters.
"""
