"""Pages of results: tables and charts from the JSON files of `benchmarks/results`, filled into `docs/results`."""
