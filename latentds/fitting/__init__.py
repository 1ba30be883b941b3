"""How ψ is fitted: where latent points lie, homotopies from a line to a curve, greedy matching, joint refinement."""
