"""One inference problem: residual rows, their noise, parameters with priors, evidence and covariance. docs/method/estimator.md has the equations."""
