// Stub of rclcpp_lifecycle::State.
#ifndef STUB_RCLCPP_LIFECYCLE_STATE_HPP_
#define STUB_RCLCPP_LIFECYCLE_STATE_HPP_

namespace rclcpp_lifecycle {
class State {};
}  // namespace rclcpp_lifecycle

#endif
