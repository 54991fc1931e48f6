// The control loop and its thread as a Python object. Python supplies nominal controls and scenes, and reads the log; no
// call of Python runs in the loop.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>

#include <cmath>
#include <cstddef>
#include <cstring>
#include <limits>
#include <memory>
#include <stdexcept>
#include <string>
#include <type_traits>

#include "conversion/buffers.h"
#include "kernel.h"

extern "C" {
#include "dbk_control_thread.h"
#include "drivers/dbk_packet_driver.h"
#include "drivers/dbk_ring_driver.h"
#include "drivers/dbk_simulated_arm.h"
}

namespace {

double number(const nb::dict &d, const char *key) { return nb::cast<double>(d[key]); }

void read_joints(const nb::dict &d, const char *key, size_t n, double *to) {
  const Array a = nb::cast<Array>(d[key]);
  expect(a.size() == n, key);
  for (size_t k = 0; k < DBK_MAX_DOF; ++k) { to[k] = k < n ? a.data()[k] : 0.0; }
}

void parse_limits(const nb::dict &d, size_t n, dbk_control_limits *to) {
  to->period = number(d, "period");
  to->command_period = number(d, "command_period");
  to->tick_lost_after = number(d, "tick_lost_after");
  to->state_stale_after = number(d, "state_stale_after");
  to->state_lost_after = number(d, "state_lost_after");
  to->max_loop_delay = number(d, "max_loop_delay");
  to->max_clock_skew = number(d, "max_clock_skew");
  to->drive_on_timeout = number(d, "drive_on_timeout");
  to->drive_on_silence = number(d, "drive_on_silence");
  to->control_valid = number(d, "control_valid");
  to->caller_lost_after = number(d, "caller_lost_after");
  to->scene_old_after = number(d, "scene_old_after");
  to->max_source_gap = number(d, "max_source_gap");
  to->max_tracking_gap = number(d, "max_tracking_gap");
  to->tracking_lost_gap = number(d, "tracking_lost_gap");
  to->leak_time = number(d, "leak_time");
  to->max_position_jump = number(d, "max_position_jump");
  to->lag = number(d, "lag");
  to->rest_velocity = number(d, "rest_velocity");
  to->slow_scale = number(d, "slow_scale");
  read_joints(d, "q_least", n, to->q_least);
  read_joints(d, "q_most", n, to->q_most);
  read_joints(d, "overspeed", n, to->overspeed);
  read_joints(d, "control_limit", n, to->control_limit);
  read_joints(d, "velocity_limit", n, to->velocity_limit);
  read_joints(d, "braking_step", n, to->braking_step);
}

// name, type in numpy's notation, number of elements, offset
template <typename T>
nb::tuple field(const char *name, size_t offset, size_t size) {
  const char *kind = std::is_floating_point_v<T> ? "f" : (std::is_signed_v<T> ? "i" : "u");
  return nb::make_tuple(name, std::string(kind) + std::to_string(sizeof(T)), size / sizeof(T), offset);
}

#define RECORD_FIELD(name)                                                                                             \
  fields.append(field<std::remove_all_extents_t<decltype(dbk_tick_record::name)>>(#name, offsetof(dbk_tick_record, name), \
                                                                                  sizeof(dbk_tick_record::name)))
#define STATE_FIELD(name)                                                                                               \
  fields.append(field<std::remove_all_extents_t<decltype(dbk_joint_state::name)>>(                                      \
      "state_" #name, offsetof(dbk_tick_record, state) + offsetof(dbk_joint_state, name), sizeof(dbk_joint_state::name)))

nb::list record_fields() {
  nb::list fields;
  RECORD_FIELD(tick);
  RECORD_FIELD(now_us);
  RECORD_FIELD(scene_number);
  RECORD_FIELD(control_number);
  RECORD_FIELD(external);
  RECORD_FIELD(conditions);
  STATE_FIELD(sequence);
  STATE_FIELD(stamp_us);
  STATE_FIELD(q);
  STATE_FIELD(v);
  STATE_FIELD(opening);
  STATE_FIELD(drive_enabled);
  STATE_FIELD(has_desired);
  STATE_FIELD(desired_v);
  STATE_FIELD(desired_a);
  RECORD_FIELD(u_nom);
  RECORD_FIELD(u);
  RECORD_FIELD(speed_scale);
  RECORD_FIELD(delta);
  RECORD_FIELD(h_min);
  RECORD_FIELD(new_state);
  RECORD_FIELD(state_used);
  RECORD_FIELD(drive_off);
  RECORD_FIELD(standstill);
  RECORD_FIELD(continued);
  RECORD_FIELD(status);
  RECORD_FIELD(flags);
  RECORD_FIELD(certified);
  RECORD_FIELD(iterations);
  RECORD_FIELD(n_rows);
  RECORD_FIELD(action);
  RECORD_FIELD(check);
  RECORD_FIELD(drive_enable);
  RECORD_FIELD(at_standstill);
  RECORD_FIELD(wake_late_us);
  RECORD_FIELD(work_us);
  return fields;
}

class ControlLoop {
 public:
  // the robot: with `home`, `braking` and `lag` a simulated arm, with `socket` >= 0 the process behind it, otherwise the rings
  ControlLoop(const Kernel &kernel, const nb::dict &limits, const nb::dict &arm, int socket) : n_(kernel.n) {
    dbk_control_tick &tick = loop_->tick;
    tick.model = *kernel.model;
    tick.hull_model = kernel.hull_model ? *kernel.hull_model : *kernel.model;
    parse_limits(limits, n_, &tick.limits);
    tick.limits.opening_max = kernel.hull_model ? kernel.opening_max : -1.0;
    dbk_driver driver = dbk_ring_driver_init(rings_.get());
    if (nb::len(arm) > 0) {
      double home[DBK_MAX_DOF], braking[DBK_MAX_DOF];
      read_joints(arm, "home", n_, home);
      read_joints(arm, "braking", n_, braking);
      driver = dbk_simulated_arm_init(&arm_, static_cast<int32_t>(n_), home, braking, number(arm, "lag"));
    } else if (socket >= 0) {
      driver = dbk_packet_driver_init(&packets_, socket, static_cast<int32_t>(n_));
    }
    dbk_control_loop_init(loop_.get(), driver);
  }
  ControlLoop(const ControlLoop &) = delete;
  ControlLoop &operator=(const ControlLoop &) = delete;
  ~ControlLoop() { stop(); }

  void tick(uint64_t now_us) {
    expect(!thread_.running, "the thread ticks");
    const dbk_driver &driver = loop_->driver;
    dbk_control_loop_tick(loop_.get(), driver.clock ? driver.clock(driver.self, now_us) : now_us, 0, 0);
  }

  int start(uint64_t period_us, int priority, bool lock_process) {
    expect(!thread_.running, "the thread runs already");
    return dbk_control_thread_start(&thread_, loop_.get(), period_us, priority, lock_process);
  }

  void stop() {
    if (!thread_.running) { return; }
    const nb::gil_scoped_release release;
    dbk_control_thread_stop(&thread_);
  }

  bool submit_control(const Array &u, bool standstill, uint64_t control_number) {
    expect(u.size() == n_, "u_nom");
    return dbk_control_loop_submit_control(loop_.get(), u.data(), standstill, control_number) != 0;
  }

  void submit_scene(const Kernel &kernel, double stamp, uint64_t scene_number) {
    dbk_stamped_scene *slot = dbk_control_loop_scene_slot(loop_.get());
    slot->scene = *kernel.scene;
    slot->stamp = stamp;
    slot->number = scene_number;
    dbk_control_loop_submit_scene(loop_.get());
  }

  // `desired`: desired_v and desired_a of n joints each, or empty
  bool push_state(uint64_t sequence, uint64_t stamp_us, const Array &q, const Array &v, double opening, bool drive,
                  const Array &desired) {
    expect(q.size() == n_ && v.size() == n_, "joints of a state");
    expect(desired.size() == 0 || desired.size() == 2 * n_, "desired motion of a state");
    dbk_joint_state state{};
    state.sequence = sequence;
    state.stamp_us = stamp_us;
    state.opening = opening;
    state.drive_enabled = drive;
    std::memcpy(state.q, q.data(), n_ * sizeof(double));
    std::memcpy(state.v, v.data(), n_ * sizeof(double));
    state.has_desired = desired.size() > 0;
    if (state.has_desired) {
      std::memcpy(state.desired_v, desired.data(), n_ * sizeof(double));
      std::memcpy(state.desired_a, desired.data() + n_, n_ * sizeof(double));
    }
    return dbk_ring_push(&rings_->states, &state) != 0;
  }

  // list of (tick, u, drive_enable), oldest first
  nb::list pop_commands() {
    nb::list all;
    dbk_joint_command command;
    while (dbk_ring_driver_take_command(rings_.get(), &command)) {
      nb::list u;
      for (size_t k = 0; k < n_; ++k) { u.append(command.u[k]); }
      all.append(nb::make_tuple(command.tick, nb::tuple(u), command.drive_enable != 0));
    }
    return all;
  }

  nb::bytes drain_log() {
    const size_t count = static_cast<size_t>(dbk_ring_size(&loop_->log)), size = sizeof(dbk_tick_record);
    std::string bytes(count * size, '\0');
    for (size_t i = 0; i < count; ++i) { dbk_ring_pop(&loop_->log, bytes.data() + i * size); }
    return nb::bytes(bytes.data(), bytes.size());
  }

  nb::dict status() const {
    nb::dict d;
    d["running"] = thread_.running != 0;
    d["finished"] = __atomic_load_n(&loop_->finished, __ATOMIC_ACQUIRE) != 0;
    d["fifo"] = thread_.fifo != 0;
    d["fifo_error"] = thread_.fifo_error;
    d["memory_lock"] = thread_.memory_lock;
    d["lock_error"] = thread_.lock_error;
    d["last_tick_us"] = __atomic_load_n(&thread_.last_tick_us, __ATOMIC_ACQUIRE);
    d["late"] = __atomic_load_n(&thread_.late, __ATOMIC_RELAXED);
    d["skipped"] = __atomic_load_n(&thread_.skipped, __ATOMIC_RELAXED);
    d["max_late_us"] = __atomic_load_n(&thread_.max_late_us, __ATOMIC_RELAXED);
    d["max_work_us"] = __atomic_load_n(&thread_.max_work_us, __ATOMIC_RELAXED);
    d["log_dropped"] = __atomic_load_n(&loop_->log.dropped, __ATOMIC_RELAXED);
    d["malformed"] = __atomic_load_n(&packets_.malformed, __ATOMIC_RELAXED);
    d["unsent"] = __atomic_load_n(&packets_.unsent, __ATOMIC_RELAXED);
    d["refused"] = __atomic_load_n(&loop_->refused, __ATOMIC_RELAXED);
    return d;
  }

  dbk_control_loop *loop() { return loop_.get(); }

 private:
  size_t n_;
  std::unique_ptr<dbk_control_loop> loop_{new dbk_control_loop()};
  std::unique_ptr<dbk_ring_driver> rings_{new dbk_ring_driver()};
  dbk_simulated_arm arm_{};
  dbk_packet_driver packets_{};
  dbk_control_thread thread_{};
};

}  // namespace

void bind_control_loop(nb::module_ &m) {
  nb::class_<ControlLoop>(m, "ControlLoop")
      .def(nb::init<const Kernel &, const nb::dict &, const nb::dict &, int>())
      .def("tick", &ControlLoop::tick)
      .def("start", &ControlLoop::start)
      .def("stop", &ControlLoop::stop)
      .def("submit_control", &ControlLoop::submit_control)
      .def("submit_scene", &ControlLoop::submit_scene)
      .def("push_state", &ControlLoop::push_state)
      .def("pop_commands", &ControlLoop::pop_commands)
      .def("drain_log", &ControlLoop::drain_log)
      .def("status", &ControlLoop::status)
      .def("hold", [](ControlLoop &c, uint64_t conditions, bool held) { dbk_control_loop_hold(c.loop(), conditions, held); })
      .def("press", [](ControlLoop &c, uint64_t buttons) { dbk_control_loop_press(c.loop(), buttons); })
      .def("call", [](ControlLoop &c) { dbk_control_loop_call(c.loop()); })
      .def("take_conditions", [](ControlLoop &c) { return dbk_control_loop_take_conditions(c.loop()); })
      .def("set_drive", [](ControlLoop &c, bool on) { dbk_control_loop_set_drive(c.loop(), on); })
      .def("set_speed", [](ControlLoop &c, double scale) { return dbk_control_loop_set_speed(c.loop(), scale) != 0; })
      .def_static("record_layout", [] { return nb::make_tuple(record_fields(), sizeof(dbk_tick_record)); });
}
