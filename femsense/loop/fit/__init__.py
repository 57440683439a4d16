"""Joint fits, their noise, covariance and discretisation error."""
