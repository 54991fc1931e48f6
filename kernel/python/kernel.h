// One safety filter as a Python object: the model, the scene and the state between steps.
#ifndef DBK_KERNEL_H
#define DBK_KERNEL_H

#include <nanobind/nanobind.h>
#include <nanobind/stl/tuple.h>

#include <memory>

#include "conversion/buffers.h"
#include "conversion/result_pool.h"
#include "dbk/dbk.h"

namespace nb = nanobind;

struct Kernel {
  std::unique_ptr<dbk_model> model{new dbk_model()};
  // the model whose finger spheres cover every opening, for states of an unknown opening; null without fingers
  std::unique_ptr<dbk_model> hull_model;
  double opening_max = 0.0;  // of the gripper, per finger [m]
  double given_opening = 0.0;  // of the last step [m]
  std::unique_ptr<dbk_scene> scene{new dbk_scene()};
  // the state of the steps and of the projections
  std::unique_ptr<dbk_ctx> ctx{new dbk_ctx()}, projection_ctx{new dbk_ctx()};
  dbk_in in{};
  dbk_out out{};
  size_t n = 0;
  ResultPool pool;                   // control arrays of former results
  nb::object result_type, statuses;  // type of the result of a step, and the status objects by number

  explicit Kernel(const nb::dict &d);

  // set_scene.cpp: the scene
  void set_obstacles(const Array &rows);
  // removes the contact permits of the current obstacles and of the padding
  void clear_permits();
  // power and force limiting near an obstacle of the table: speed [m/s] within a distance [m], deceleration [m/s^2] and
  // minimum assumed speed of the person [m/s]
  void limit_near(int obstacle, double speed, double distance, double brake, double approach);
  void permit(int link, int obstacle, double speed);
  // spheres (k, 4) of a held object in the last frame, and its position error [m]
  void attach(const Array &spheres, double error);
  // rows a'u >= b of the following steps: (k, n + 3) with a, b, h, rank
  void constrain(const Array &rows);
  // pose of the base for the following steps: rotation 9 row-major, position 3
  void set_base_pose(const Array &pose);

  // step.cpp: control sets the type of the result of a step; it is called with u, u_nom, names, status, flags, delta,
  // delta_rows, delta_box, h_min, certified, iterations, n_rows, active rows (packed: three int32 and two doubles
  // each), relaxed; after a step with the status STOPPED or FAULT also with 0 and the evidence, see stop_evidence
  void set_result_type(nb::object type, nb::object status_objects);
  void reset(const Array &u_prev, const Array &u_change);
  // `opening` is a number, or Ellipsis if it is unknown (None would take a slower call): then the finger spheres cover
  // every opening
  nb::object step(nb::handle q, nb::handle v, nb::handle u_nom, nb::handle opening, nb::handle state_age,
                  nb::handle scene_age, nb::handle names);
  int project(nb::handle q, nb::handle v, nb::handle u_nom, const Array &u_prev, nb::handle opening,
              nb::handle state_age, nb::handle scene_age, double extra, const Out &u);
  // the rows of q, v, u_nom, u_prev (m, n) are independent states of a robot with a fixed base: each step starts from
  // its own u_prev without a warm start, and the state of the filter does not change. `opening` has one number for each
  // state, or none: then no opening is known
  void batch(const Array &q, const Array &v, const Array &u_nom, const Array &u_prev, const Array &opening,
             double scene_age, const Out &u, const Bytes &status, const Out &delta, const Out &h_min,
             const Integers &flags) const;

  // read_state.cpp: the last step and the kinematics all rows of the last step that a control within the bounds can
  // violate: list of (kind, i, j, h, norm, b, a...)
  nb::list rows();
  // lower and upper control bounds of the last step
  nb::tuple box() const;
  // tool pose and its Jacobian: position 3, rotation 9, jacobian (6, n), one flat array
  void tool(const Array &q, const Out &to);
  // centres and radii (k, 4) at posture q; returns k. With NaN the finger spheres cover every opening
  int spheres(const Array &q, double opening, const Out &to);

  // debug_readout.cpp: all intermediate values of the last step, for tests; the broad phase is repeated with `extra`
  // and `known_only`
  nb::dict debug_readout(double extra, bool known_only) const;
  // fills the state with a byte before its initialisation, as uninitialised memory of a C caller
  void fill_memory(int byte);

  // benchmark_loops.cpp: many steps in C
  nb::dict closed_loop(const Out &q, uint64_t seed, int hold, double toward, const Out &q_log, const Out &u_log,
                       const Bytes &status_log);
  // mean time of one step over recorded states (steps, n) [s]
  double time_steps(const Array &q, const Array &u_nom, bool cold);

 private:
  const dbk_model *used_model = model.get();  // of the last step: `model` or `hull_model`
  // the model for an opening, with or without fingers
  const dbk_model *model_of(bool opening_known) const {
    return opening_known || !hull_model ? model.get() : hull_model.get();
  }
  // the opening for the kernel: NaN, which it rejects, if the gripper cannot be open that far
  dbk_real plausible_opening(double opening) const;
  // sets `in` and `used_model`; returns the array of u_nom
  nb::object load(nb::handle q, nb::handle v, nb::handle u, nb::handle opening, nb::handle state_age,
                  nb::handle scene_age);
  // the active rows of `out`, packed
  nb::object active() const;
  // stop_evidence.cpp: why the last step stopped, a tuple of (flag, kind, i, j, value, limit) with one entry per flag
  nb::object stop_evidence() const;
};

#endif
