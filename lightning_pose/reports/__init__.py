"""Reports: `store` reads runs, `select` filters them, `compare` refuses mixtures, `tables` joins them, others show."""
