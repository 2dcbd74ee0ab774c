% From a run to numbers in MATLAB or GNU Octave (run with Octave 7.3; untested in MATLAB, which needs R2016b or newer):
%
%     octarm run --out runs/first
%     octarm export runs/first --mat
%     read_recording            (in this folder; set `file` before, if the recording is elsewhere)
%
% Arrays are (ticks, nodes, fields); NAME_fields has the names of the fields, run_json everything else.

if ~exist('file', 'var'), file = '../runs/first/recording.mat'; end
r = load(file);
run_facts = jsondecode(r.run_json);
fprintf('%d nodes, %d ticks of %g s, arm %s\n', run_facts.nodes, run_facts.ticks, run_facts.tick_s, run_facts.arm.name);

% How fast does the estimate's error decay? A line through the logarithm of its norm, down to a tenth.
apart = r.estimate - r.truth;
weights = reshape(r.energy_weights, [1, size(r.energy_weights)]);
err = sqrt(sum(sum(apart.^2 .* weights, 3), 2));
usable = isfinite(err) & err > 0.1 * err(1);
p = polyfit(r.time_s(usable), log(err(usable)), 1);
fprintf('the error decays with %.4f 1/s, from %.3g to %.3g sqrt(J)\n', -p(1), err(1), err(end));

% How long does a sweep take? (0: none ended in that tick)
d = 1e-6 * r.sweep_timing(:, strcmp(r.sweep_timing_fields, 'duration_wall_ns'));
d = sort(d(d > 0));
fprintf('a sweep takes %.2f ms (median), %.2f ms (99 of 100 take less)\n', median(d), d(ceil(0.99 * numel(d))));

% Curvature, estimate against truth, at the root.
k = strcmp(r.estimate_fields, 'curvature_per_m');
if ~exist('no_plot', 'var')
  plot(r.time_s, r.truth(:, 1, k), 'k', r.time_s, r.estimate(:, 1, k), '--');
  xlabel('time [s]'); ylabel('curvature at the root [1/m]'); legend('truth', 'estimate');
end
