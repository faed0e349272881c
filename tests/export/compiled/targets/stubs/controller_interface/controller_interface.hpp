// What the controller of examples/compiled uses of ros2_control (Humble, Jazzy).
#pragma once
#include <cstddef>
#include <string>
#include <vector>

namespace rclcpp {
class Time {};
class Duration {};
}  // namespace rclcpp
namespace rclcpp_lifecycle {
class State {};
}  // namespace rclcpp_lifecycle

namespace controller_interface {
enum class return_type : unsigned char { OK, ERROR };
enum class CallbackReturn : unsigned char { SUCCESS, FAILURE, ERROR };
enum class interface_configuration_type : unsigned char { ALL, INDIVIDUAL, NONE };
struct InterfaceConfiguration {
  interface_configuration_type type;
  std::vector<std::string> names;
};
struct LoanedInterface {
  double get_value() const { return value; }
  void set_value(double given) { value = given; }
  double value = 0.0;
};
class ControllerInterface {
 public:
  virtual ~ControllerInterface() = default;
  virtual CallbackReturn on_init() = 0;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State &) = 0;
  virtual return_type update(const rclcpp::Time &, const rclcpp::Duration &) = 0;

 protected:
  std::vector<LoanedInterface> command_interfaces_, state_interfaces_;
};
}  // namespace controller_interface
