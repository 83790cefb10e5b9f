"""Floor 4: measured telemetry assembled with filters: attitude and drift of a record, Allan deviation of a gyro."""
