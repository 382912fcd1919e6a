"""The material base: K inconsistent predictions of every view fused into one value per surface cell (METHOD 2.3)."""
