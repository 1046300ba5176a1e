"""Robust estimators and minimal solvers on stores."""
