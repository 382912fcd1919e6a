"""Light: emitters, environment, light transport, irradiance, and relighting."""
