"""Refinement: robust weighted Levenberg-Marquardt.

``lm`` has the module and its stages, ``residual`` the one residual and its normal equations, ``information`` what noise
makes of residuals, ``terms`` priors, ``kernels`` the robust kernels, ``parameters`` values that are learned in bounds.
"""
