"""Hyperparameter search: a sweep file (`plan`, `space`), its trials (`trial`), their study (`storage`, `study`), the
processes that run them (`workers`), and the results (`parent_run`, `results`).

Objectives are measured on validation frames alone. Nothing is imported here: Optuna and Lightning take seconds.
"""
