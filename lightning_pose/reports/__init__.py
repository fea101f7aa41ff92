"""Reports: `filters` select runs, `comparability` refuses mixtures, `table` joins runs, `*_rows` add reference rows."""
