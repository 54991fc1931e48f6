// One filter as Python sees it: model, scene, and the memory from step to step.
#ifndef DBK_KERNEL_H
#define DBK_KERNEL_H

#include <nanobind/nanobind.h>
#include <nanobind/stl/tuple.h>

#include <memory>

#include "buffers.h"
#include "dbk/dbk.h"
#include "spares.h"

namespace nb = nanobind;

struct Kernel {
  std::unique_ptr<dbk_model> model{new dbk_model()};
  std::unique_ptr<dbk_scene> scene{new dbk_scene()};
  std::unique_ptr<dbk_ctx> ctx{new dbk_ctx()}, other{new dbk_ctx()};
  dbk_in in{};
  dbk_out out{};
  size_t n = 0;
  Spares controls;                   // what answers that nobody holds any more came in
  nb::object answer_type, statuses;  // what a step answers with, and its status by number

  explicit Kernel(const nb::dict &d);

  // knows.cpp: what the filter is told
  void set_obstacles(const Array &rows);
  // of the obstacles there are, and of what fills the last vector
  void clear_permits();
  void permit(int link, int obstacle, double speed);
  void attach(const Array &spheres, double error);
  // rows a'u >= b of one step: (k, n + 3) of a, b, h, rank
  void constrain(const Array &rows);
  // where the base stands from now on: rotation 9 row-major, position 3
  void stand(const Array &pose);

  // step.cpp: control
  // what a step answers with: called with u, u_nom, names, status, flags, delta, delta_rows, delta_box, h_min, certified,
  // iterations, n_rows, binding (rows of three int32 and two doubles, without gaps), relaxed
  void answer_with(nb::object type, nb::object names_of_status);
  void reset(const Array &u_prev);
  nb::object step(nb::handle q, nb::handle v, nb::handle u_nom, double opening, double state_age, double scene_age,
                  nb::handle names);
  int project(nb::handle q, nb::handle v, nb::handle wish, const Array &u_prev, double opening, double state_age,
              double scene_age, double extra, const Out &u);
  // rows of q, v, u_nom, u_prev (m, n) are independent states of a bolted body: each starts afresh from its u_prev,
  // without a warm start; the filter's own memory is left alone
  void batch(const Array &q, const Array &v, const Array &u_nom, const Array &u_prev, const Array &opening,
             double scene_age, const Out &u, const Bytes &status, const Out &delta, const Out &h_min) const;

  // look.cpp: what the last step was about, and where the robot is
  // the rows of the last step, all that a control of its box could violate: list of (kind, i, j, h, norm, b, a...)
  nb::list rows();
  nb::tuple box() const;
  // tool pose and its Jacobian: position 3, rotation 9, jacobian (6, n), one flat array
  void tool(const Array &q, const Out &to);
  int spheres(const Array &q, double opening, const Out &to);

  // inside.cpp: every number that the last step worked with, for tests; around it is seen with `extra` and `known_only`
  nb::dict inside(double extra, bool known_only) const;
  // a memory that starts from arbitrary bytes, as a caller's may
  void stain(int byte);

  // loops.cpp: many steps in C
  nb::dict closed_loop(const Out &q, uint64_t seed, int hold, double toward, const Out &q_log, const Out &u_log,
                       const Bytes &status_log);
  // mean seconds of one step along recorded states (steps, n)
  double time_steps(const Array &q, const Array &u_nom, bool cold);

 private:
  // returns u_nom as it was read
  nb::object load(nb::handle q, nb::handle v, nb::handle u, double opening, double state_age, double scene_age);
  nb::object active() const;
};

#endif
