"""What training reads: windows of prepared clips and streets, augmented and degraded as sensors degrade them."""
