// Run an exported program in OpenVINO.
//
//     scorer_openvino FOLDER [TOLERANCE]
//     scorer_openvino EXTRACTION SYSTEM QUERY.ppm CANDIDATE.ppm
//
// Prints the outputs and the largest difference from those in the folder. Exits with 1 if the difference is above the
// tolerance. With two folders: prints the scores of an image pair.

#include <openvino/openvino.hpp>

#include "arrays.h"

Outputs run(const std::string& folder, const Inputs& array_of) {
  ov::Core core;
  auto model = core.compile_model(folder + "/program.onnx", "CPU", ov::hint::inference_precision(ov::element::f32),
                                  ov::hint::execution_mode(ov::hint::ExecutionMode::ACCURACY));
  auto request = model.create_infer_request();
  std::vector<Bytes> arrays;  // the tensors use their memory
  for (const auto& input : model.inputs()) {
    arrays.push_back(array_of(input.get_any_name()));
    const ov::Tensor tensor(input.get_element_type(), input.get_shape(), arrays.back().data());
    if (tensor.get_byte_size() != arrays.back().size())
      throw std::runtime_error(input.get_any_name() + ": expected as many numbers as in the model");
    request.set_tensor(input, tensor);
  }
  request.infer();
  Outputs results;
  for (const auto& output : model.outputs()) {
    const ov::Tensor tensor = request.get_tensor(output);
    const auto* bytes = static_cast<const char*>(tensor.data());
    results.emplace_back(output.get_any_name(), Bytes(bytes, bytes + tensor.get_byte_size()));
  }
  return results;
}

int main(int argc, char** argv) { return run_example(argc, argv, run); }
