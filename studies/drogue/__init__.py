"""Pictures of a refuelling drogue with truth: basket, canopy, seven markers, light, background, disturbances."""
