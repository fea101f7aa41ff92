"""Hyperparameter search: a sweep file (`plan`, `space`), its trials (`trial`), who runs them (`study`, `workers`),
and what is left of them (`record`, `results`).

Objectives are measured on validation frames alone. Nothing is imported here: Optuna and Lightning take seconds.
"""
