// Many steps in C, for benchmarks and proofs.
#include <vector>

#include "dbk_lab.h"
#include "kernel.h"

nb::dict Kernel::closed_loop(const Out &q, uint64_t seed, int hold, double toward, const Out &q_log, const Out &u_log,
                             const Bytes &status_log) {
  dbk_tally tally{};
  tally.h_min = 1e9;
  const size_t steps = status_log.size();
  expect(q.size() == n && q_log.size() == steps * n && u_log.size() == steps * n && hold > 0, "log sizes");
  const dbk_adversary a{seed, int(steps), hold, toward};
  {
    const nb::gil_scoped_release release;
    dbk_closed_loop(model.get(), scene.get(), ctx.get(), &a, q.data(), q_log.data(), u_log.data(), status_log.data(),
                    &tally);
  }
  nb::dict d;
  const char *names[5] = {"safe", "modified", "relaxed", "stopped", "fault"};
  for (int i = 0; i < 5; ++i) { d[names[i]] = tally.status[i]; }
  d["rows"] = tally.rows;
  d["iterations"] = tally.iterations;
  d["h_min"] = tally.h_min;
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
