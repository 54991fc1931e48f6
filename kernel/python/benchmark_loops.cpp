// Loops over many steps in C, for tests and benchmarks.
#include <vector>

#include "closed_loop.h"
#include "kernel.h"

nb::dict Kernel::closed_loop(const Out &q, uint64_t seed, int hold, double toward, const Out &q_log, const Out &u_log,
                             const Bytes &status_log) {
  dbk_step_counts counts{};
  counts.h_min = 1e9;
  const size_t steps = status_log.size();
  expect(q.size() == n && q_log.size() == steps * n && u_log.size() == steps * n && hold > 0, "log sizes");
  const dbk_adversary adversary{seed, int(steps), hold, toward};
  {
    const nb::gil_scoped_release release;
    dbk_closed_loop(model.get(), scene.get(), ctx.get(), &adversary, q.data(), q_log.data(), u_log.data(),
                    status_log.data(), &counts);
  }
  nb::dict d;
  const char *names[5] = {"safe", "modified", "relaxed", "stopped", "fault"};
  for (int i = 0; i < 5; ++i) { d[names[i]] = counts.status[i]; }
  d["rows"] = counts.rows;
  d["iterations"] = counts.iterations;
  d["h_min"] = counts.h_min;
  return d;
}

double Kernel::time_steps(const Array &q, const Array &u_nom, bool cold) {
  const size_t steps = q.size() / n;
  expect(q.size() == steps * n && u_nom.size() == q.size(), "recorded states");
  std::vector<dbk_in> all(steps, dbk_in{});
  for (size_t t = 0; t < steps; ++t) {
    for (size_t k = 0; k < n; ++k) {
      all[t].q[k] = static_cast<dbk_real>(q.data()[t * n + k]);
      all[t].u_nom[k] = static_cast<dbk_real>(u_nom.data()[t * n + k]);
    }
  }
  const nb::gil_scoped_release release;
  return dbk_time_steps(model.get(), scene.get(), ctx.get(), all.data(), int(steps), cold, &out);
}
