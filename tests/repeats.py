"""Cases that `make test-all` alone runs: each shows on another kind what a case that stays in `make test` shows.

Starts of the test's name, file first, over the case that stays.
"""

REPEATS = (
    # a signal while the run is set up: on one rank; later: on two ranks; of mpirun itself
    "test_restart.py::test_a_signal_right_after_the_start[2]",
    "test_restart.py::test_a_signal_ends_a_run_with_a_checkpoint[SIGTERM-0]",
    "test_restart.py::test_ending_mpirun_itself_leaves_a_checkpoint",
    # Ctrl-C while a run imports, as SIGTERM; a step that is abandoned: of a body that flows, as of one that breaks
    "test_interrupt.py::test_a_signal_while_a_run_imports_ends_it[2]",
    "test_interrupt.py::test_a_long_step_is_abandoned[flow]",
    # a run that nobody hears: its streams are closed, or its log is full; on a terminal: without mpirun
    "test_process.py::test_a_run_goes_on_where_nobody_reads_what_it_says[> /dev/full",
    "test_progress.py::test_a_terminal_has_a_line_that_rewrites_itself[0]",
    # another study than that of the checkpoint: on one rank, as a run that would be thrown away is on two
    "test_restart.py::test_the_study_compared_is_that_of_the_checkpoint[2]",
    # a checkpoint of two ranks: on one; the exit code of what does not converge: of the other codes on two ranks
    "test_restart.py::test_a_checkpoint_of_two_ranks_goes_on_with_others[3]",
    "test_restart.py::test_the_exit_code_of_a_run_that_does_not_converge",
    # a full disk on two ranks: rows of history; the other files on one
    "test_cannot_write.py::test_a_full_disk_ends_the_run[fields-2]",
    "test_cannot_write.py::test_a_full_disk_ends_the_run[surface-2]",
    "test_cannot_write.py::test_a_full_disk_ends_the_run[checkpoint-2]",
    # a rank that fails alone: with input, and with a fault
    "test_ranks.py::test_a_rank_that_fails_alone_ends_all[1-not-converged",
    "test_ranks.py::test_a_rank_that_fails_alone_ends_all[1-exit",
    "test_ranks.py::test_a_rank_that_fails_alone_ends_all[0-disk",
    # the same while Newton waits in a reduction; bad input on two ranks: their exit codes and words, in one start
    "test_cli.py::test_a_fault_on_one_rank_ends_all",
    "test_bad_input.py::test_one_message_of_two_processes",
    # sweeps in processes of their own: one that is stopped
    "test_sweep.py::test_runs_on_two_ranks",
    # whose a folder is: on one process
    "test_file_ownership.py::test_a_folder_of_the_users_is_left_alone[2]",
    # a run that is killed as it sets up: before its first file, and after its last
    "test_file_ownership.py::test_a_run_that_was_killed_is_recognised[monitors.InvertedCellMonitor]",
    "test_file_ownership.py::test_a_run_that_was_killed_is_recognised[output.frame_files",
    # studies on a figure: those on a vase run as they do
    "test_studies.py::test_a_coarse_version_runs[jelly-figure]",
    "test_studies.py::test_a_coarse_version_runs[hammered-figure]",
    "test_studies.py::test_a_coarse_version_runs[rigid-figure]",
    "test_studies.py::test_what_the_comments_offer_is_valid[hammered-figure]",
    "test_study_file.py::test_studies_of_the_package_survive_being_written[hammered-figure]",
    "test_study_file.py::test_studies_of_the_package_survive_being_written[rigid-figure]",
    "test_studies.py::test_what_the_comments_offer_is_valid[struck-figure]",
    "test_studies.py::test_what_the_comments_offer_is_valid[jelly-figure]",
    "test_studies.py::test_a_coarse_version_runs[struck-figure]",
    "test_studies.py::test_the_blow_lands_on_a_surface_of_ones_own",
    "test_studies.py::test_full_sizes_are_those_of_the_paper",
    "test_study_file.py::test_studies_of_the_package_survive_being_written[jelly-figure]",
    # rows of the paper's table on a figure: six others
    "test_table.py::test_rows_have_the_papers_cells[jelly-figure]",
    "test_table.py::test_rows_have_the_papers_cells[jade-figure]",
    "test_table.py::test_rows_have_the_papers_cells[porcelain-figure]",
    # a figure by its defaults: it is built by them, and checked, in test_meshes_builders
    "test_required_keys.py::test_builders_require_nothing[figure]",
    # pictures by other fields: a number (age), a component (stress:xy), exploded
    "test_surface_run.py::test_looks_differ_and_show_something[look0]",
    "test_surface_run.py::test_looks_differ_and_show_something[look2]",
    "test_surface_run.py::test_looks_differ_and_show_something[look3]",
    "test_surface_run.py::test_looks_differ_and_show_something[look1]",
    "test_surface_run.py::test_looks_differ_and_show_something[look6]",
    "test_study_file.py::test_studies_of_the_package_survive_being_written[struck-figure]",
    # builders and surfaces: the cube and the torus in one other unit, the solid figure, the vase
    "test_meshes_fill.py::test_the_unit_of_length_does_not_matter[cube-shell0-0.3-1000.0]",
    "test_meshes_fill.py::test_the_unit_of_length_does_not_matter[torus-shell1-0.2-1000.0]",
    "test_meshes_fill.py::test_cells_are_expected_within_a_factor[torus]",
    "test_meshes_fill.py::test_volume_is_that_of_the_surface[notched-bar",
    "test_meshes_builders.py::test_cells_are_positive_and_the_check_has_nothing_to_say[figure-0.4",
    "test_meshes_builders.py::test_facets_are_shared_by_two_cells_and_the_boundary_is_closed[figure-0.4",
    "test_meshes_builders.py::test_boundary_normals_point_outwards[figure-0.4",
    "test_meshes_builders.py::test_groups_are_those_announced_and_cover_the_boundary_once[figure-0.4",
    "test_meshes_builders.py::test_bounds_are_known_before_building[figure-0.4",
    "test_meshes_builders.py::test_cells_are_estimated[figure-0.4",
    "test_meshes_builders.py::test_plane_groups_lie_on_their_planes[figure-0.4",
    "test_meshes_builders.py::test_a_hollow_figure_is_nowhere_thinner_than_its_wall",
    # plane strain against 3D: neo-hookean; corotated and stvk by their closed forms in both
    "test_energies.py::test_plane_strain_is_3d_at_unit_thickness_stretch[corotated]",
    "test_energies.py::test_plane_strain_is_3d_at_unit_thickness_stretch[stvk]",
    "test_patch.py::test_static_patch[corotated",
    "test_patch.py::test_static_patch[stvk",
    # further energies of plasticity: neo-hookean, the default
    "test_plasticity.py::test_stress_beyond_yield_decays_with_the_flow_rate[corotated]",
    "test_plasticity.py::test_stress_beyond_yield_decays_with_the_flow_rate[stvk]",
    "test_plasticity.py::test_plastic_volume_is_kept[corotated]",
    "test_plasticity.py::test_plastic_volume_is_kept[stvk]",
    "test_plasticity.py::test_a_step_is_solved_with_the_last_flow_once_more[corotated]",
    "test_plasticity.py::test_a_step_is_solved_with_the_last_flow_once_more[stvk]",
    "test_plasticity.py::test_the_return_is_that_of_a_dense_solver[corotated",
    "test_plasticity.py::test_the_return_is_that_of_a_dense_solver[stvk",
    "test_plasticity.py::test_energy_balance[newmark]",
    # balances of breaking bodies: generalized-alpha with both approaches, which is of second order as Newmark is
    "test_fracture.py::test_energy_balance_of_dynamic_fracture[edge-newmark]",
    "test_fracture.py::test_energy_balance_of_dynamic_fracture[chi-newmark]",
    "test_closing.py::test_explicit_steps_stay_stable_with_damage[edge-True-1]",
    # bars that meet: neo-hookean, and linear with both approaches
    "test_closing.py::test_equal_bars_exchange_their_velocities[chi-corotated]",
    "test_closing.py::test_equal_bars_exchange_their_velocities[chi-stvk]",
    # free obstacles: generalized-alpha of Newmark and backward Euler; a mass between a heavy and a light one
    "test_free_obstacles.py::test_an_isolated_pair_keeps_its_momentum[generalized-alpha]",
    "test_free_obstacles.py::test_an_isolated_pair_keeps_its_momentum[backward-euler]",
    "test_free_obstacles.py::test_a_free_striker_faster_than_its_step_does_not_tunnel[0.1]",
    # trials of the report: the other rows of its table
    "test_evidence_stability.py::test_two_approaches_fail_and_chi_holds",
    # a body that tumbles: Newmark and backward Euler; grains in 3D: of unequal weights, and of a curved surface
    "test_rigid_step.py::test_a_body_that_tumbles_keeps_its_angular_momentum[GeneralizedAlpha]",
    "test_grains.py::test_a_surface_frees_the_grain_that_it_starts_in[0.0-3]",
    "test_grains.py::test_bias_runs_along_grain_boundaries[3-planar]",
    "test_grains.py::test_cuts_are_where_energies_are_equal[0.0-3]",
    # surfaces in 3D: of the same test in 2D
    "test_brittle.py::test_moving_nodes_over_spares_a_curved_surface[3]",
    "test_barrier.py::test_nothing_tunnels_through_a_thin_capsule[2]",
    "test_shapes.py::test_distance_is_that_to_the_closest_point_of_the_surface[stadium]",
    "test_shapes.py::test_distance_is_that_to_the_closest_point_of_the_surface[ring]",
    "test_shapes.py::test_distance_is_that_to_the_closest_point_of_the_surface[drum]",
    # facets before other shapes: a capsule is a ball along an axis, a cylinder a box about one
    "test_facets.py::test_the_place_is_the_deepest[capsule]",
    "test_facets.py::test_the_place_is_the_deepest[cylinder]",
    "test_facets.py::test_forces_and_stiffness_are_derivatives[capsule]",
    "test_facets.py::test_forces_and_stiffness_are_derivatives[cylinder]",
    # a ball of the size of a facet: one far smaller
    "test_facets.py::test_no_facet_is_cut[2-0.3]",
    "test_facets.py::test_no_facet_is_cut[3-0.3]",
    # a striker of the size of an edge, felt between points: a large one
    "test_obstacles.py::test_a_striker_faster_than_its_step_does_not_tunnel[0.1]",
    # the other scheme of second order
    "test_curved_gap.py::test_a_round_press_gains_nothing[newmark]",
    "test_contact_time_weights.py::test_a_body_that_breaks_as_it_lands_keeps_the_books[newmark]",
    "test_obstacle_pairs.py::test_a_weight_bounces_on_a_held_floor[newmark-0.8]",
    "test_obstacle_pairs.py::test_a_driven_wall_takes_a_weight_along[3.0-newmark]",
    "test_obstacle_pairs.py::test_a_driven_wall_takes_a_weight_along[30.0-newmark]",
    "test_contact_time_weights.py::test_a_bounce_returns_the_height_less_the_loss_of_the_scheme[newmark",
    "test_obstacles.py::test_the_impulse_of_contact_is_what_balances_momentum[newmark]",
    "test_obstacles.py::test_a_step_that_balances_inside_books_what_its_obstacle_did[newmark]",
    # the V-cycle written out: with thorough smoothing of coarser levels in 3D, without in 2D
    "test_cycle.py::test_it_is_multigrid_written_out[2-0.0]",
    "test_cycle.py::test_it_is_multigrid_written_out[3-1.0]",
    # contact beside blocks, a ball that begins to roll: on three ranks
    "test_block_matrix.py::test_contact_beside_blocks_is_that_of_single_entries[2]",
    "test_rolling_ball.py::test_a_ball_begins_to_roll_alike_on_any_number_of_ranks[2]",
    # a weight that slides: just below the tangent, and solids at half of it
    "test_obstacle_pairs.py::test_a_weight_rubs_on_a_held_floor[0.3]",
    # thick boats of small cells: thin ones of small cells, thick ones of large cells; a block that slides, solved by
    # projections: with the other friction
    "test_rigid_shells.py::test_a_boat_dropped_into_a_boat_comes_to_lie_in_it[0.2-0.04]",
    "test_engine.py::test_a_block_slides_as_coulomb_says[projections-0.2]",
    # an obstacle from a file beside a torn body: by its barrier if it spins, by its penalty if it does not
    "test_clearance.py::test_nothing_far_is_near[spinning mesh-explicit-torn]",
    "test_clearance.py::test_nothing_far_is_near[mesh-implicit-torn]",
    # a bar that spalls, by generalized-alpha: by Newmark
    "test_spall.py::test_a_cohesive_plane_with_inertia[generalized-alpha",
    # round bodies of large cells that roll down an incline: of small cells; of large cells down a box
    "test_rigid_rolling.py::test_round_bodies_roll_down_an_incline[cylinder-0.05",
    "test_rigid_rolling.py::test_round_bodies_roll_down_an_incline[capsule-0.05",
    "test_rigid_rolling.py::test_round_bodies_roll_down_an_incline[sphere-0.05",
)
