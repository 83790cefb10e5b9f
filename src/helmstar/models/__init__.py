"""Floor 2: processes and sensors with the retractions they belong to."""
