"""What `report` prints: `store` reads runs, `select` filters, `compare` refuses mixtures, `tables` joins, the rest show."""
